#pragma once
#include "gran_sub_mod.h"
namespace LAMMPS_NS {
namespace Granular_NS {
class GranSubModNormal : public GranSubMod {
 public:
  GranSubModNormal(GranularModel *model, LAMMPS *lmp) : GranSubMod(model, lmp), damp(0.0) {}
  virtual double calculate_forces() = 0;

 protected:
  double damp;
};
}    // namespace Granular_NS
}    // namespace LAMMPS_NS
