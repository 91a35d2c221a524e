#pragma once
#include "pointers.h"
namespace LAMMPS_NS {
namespace Granular_NS {
enum ContactType { PAIR = 0, WALL = 1, WALLREGION = 2 };
class GranularModel {
 public:
  int history_update, i, j;
  ContactType contact_type;
  double *history, radi, radj, delta;
};
}    // namespace Granular_NS
}    // namespace LAMMPS_NS
