// Plays a pair of two materials and a wall through the sub-model; prints force and history next to the header's.
#include <cstdio>

#include "atom.h"
#include "error.h"
#include "gran_sub_mod_mcc.h"

using namespace LAMMPS_NS;
using namespace Granular_NS;

int main()
{
  Atom atom;
  Error error;
  LAMMPS lmp = {&atom, &error};
  GranularModel model;
  const mcc_law law = MCC_LAW_CALIBRATED;
  mcc_law other = law;
  other.C1 *= 1.5;
  double C1[2] = {law.C1, other.C1}, *values[1] = {C1};
  atom.dvector = values;
  atom.index["C1"] = 0;
  double history[3] = {-7.0, 0.0, -7.0};
  double coeffs[6] = {law.effective_modulus, law.C1, law.C3, law.C5, law.a, 0.1};
  GranSubModNormalMCC normal(&model, &lmp);
  normal.coeffs = coeffs;
  normal.history_index = 1;
  normal.mix_coeffs(coeffs, coeffs);
  model.history = history;
  model.i = 1;
  model.j = 0;
  model.radi = 60e-6;
  model.radj = 90e-6;
  const mcc_contact i = mcc_half_contact(&other, 120e-6, 120e-6, 120e-6);
  const mcc_contact j = mcc_half_contact(&law, 180e-6, 180e-6, 180e-6);
  const double path[] = {0.0, 1e-5, 2e-5, 1.99e-5, 1.95e-5, 1e-5, 3e-5};
  for (int kind = 0; kind < 2; kind++) {
    double x_max = history[1] = 0.0;
    model.contact_type = kind ? WALLREGION : PAIR;
    for (double x : path) {
      const mcc_response want = mcc_pair_step(&i, kind ? nullptr : &j, x_max, x);
      x_max = want.x_max;
      model.delta = x;
      model.history_update = 0;
      const double twice = normal.calculate_forces();
      model.history_update = 1;
      const double force = normal.calculate_forces();
      std::printf("%.17g %.17g %.17g %.17g %.17g\n", force, want.force, history[1], x_max, twice);
    }
  }
  double wrong[6] = {law.effective_modulus, 2 * law.C1, law.C3, law.C5, law.a, 0.1};
  try {
    normal.mix_coeffs(coeffs, wrong);
    return 1;
  } catch (const std::runtime_error &) {
  }
  return history[0] == -7.0 && history[2] == -7.0 && normal.transfer_history_factor[0] == 1.0 ? 0 : 1;
}
