#pragma once
#include "granular_model.h"
#include "pointers.h"
namespace LAMMPS_NS {
namespace Granular_NS {
class GranSubMod : protected Pointers {
 public:
  GranSubMod(GranularModel *model, LAMMPS *lmp) : Pointers(lmp), transfer_history_factor(nullptr), gm(model) {}
  ~GranSubMod() override { delete[] transfer_history_factor; }
  int num_coeffs, size_history, nondefault_history_transfer, history_index;
  double *coeffs, *transfer_history_factor;
  virtual void mix_coeffs(double *, double *) {}
  virtual void coeffs_to_local() {}
  GranularModel *gm;
};
}    // namespace Granular_NS
}    // namespace LAMMPS_NS
