#pragma once
#include <stdexcept>
#include <string>
namespace LAMMPS_NS {
class Error {
 public:
  [[noreturn]] void all(const std::string &, int, const std::string &text) { throw std::runtime_error(text); }
};
}    // namespace LAMMPS_NS
