#pragma once
#define FLERR __FILE__, __LINE__
namespace LAMMPS_NS {
class Atom;
class Error;
class LAMMPS {
 public:
  Atom *atom;
  Error *error;
};
class Pointers {
 public:
  explicit Pointers(LAMMPS *lmp) : atom(lmp->atom), error(lmp->error) {}
  virtual ~Pointers() {}

 protected:
  Atom *atom;
  Error *error;
};
}    // namespace LAMMPS_NS
