#pragma once
#include <map>
#include <string>
#include <vector>
namespace LAMMPS_NS {
class Atom {
 public:
  std::map<std::string, int> index;
  double **dvector;
  int find_custom(const char *name, int &flag, int &columns)
  {
    if (!index.count(name)) return -1;
    flag = 1;
    columns = 0;
    return index[name];
  }
};
}    // namespace LAMMPS_NS
