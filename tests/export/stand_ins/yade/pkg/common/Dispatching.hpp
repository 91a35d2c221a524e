#pragma once
#include <algorithm>
#include <cmath>
#include <map>
#include <memory>
#include <stdexcept>
#include <utility>

// A sequence ((type, name, value, flags, doc))((...)) becomes members of the class.
#define MEMBER(type, name, value, flags, doc) type name = value;
#define MEMBERS_A(item) MEMBER item MEMBERS_B
#define MEMBERS_B(item) MEMBER item MEMBERS_A
#define MEMBERS_A_END
#define MEMBERS_B_END
#define END(...) END_(__VA_ARGS__)
#define END_(...) __VA_ARGS__##_END
#define YADE_CLASS_BASE_DOC_ATTRS_CTOR(name, base, doc, attributes, constructor)                                       \
	END(MEMBERS_A attributes)                                                                                      \
	name() { constructor }                                                                                         \
	using base_class = base
#define YADE_CLASS_BASE_DOC(name, base, doc) using base_class = base
#define FUNCTOR2D(one, two) using dispatched = std::pair<one, two>
#define REGISTER_CLASS_INDEX(name, base) using indexed = base
#define REGISTER_SERIALIZABLE(name) static_assert(sizeof(name) > 0, "a whole class")
#define YADE_PLUGIN(names) static_assert(true, "")

namespace yade {

using Real = double;
using std::shared_ptr;

struct Vector3r {
	Real x = 0, y = 0, z = 0;
	static Vector3r Zero() { return {}; }
	Vector3r() = default;
	Vector3r(Real a, Real b, Real c) : x(a), y(b), z(c) { }
	Real      squaredNorm() const { return x * x + y * y + z * z; }
	Real      norm() const { return std::sqrt(squaredNorm()); }
	Vector3r  operator+(const Vector3r& o) const { return { x + o.x, y + o.y, z + o.z }; }
	Vector3r  operator-(const Vector3r& o) const { return { x - o.x, y - o.y, z - o.z }; }
	Vector3r  operator-() const { return { -x, -y, -z }; }
	Vector3r& operator-=(const Vector3r& o) { return *this = *this - o; }
	Vector3r& operator*=(Real s) { return *this = Vector3r(x * s, y * s, z * s); }
};
inline Vector3r operator*(Real s, const Vector3r& v) { return { v.x * s, v.y * s, v.z * s }; }

struct Indexed {
	virtual ~Indexed() { }
	void createIndex() { }
};
struct Shape : Indexed { };
struct Sphere : Shape {
	Real radius = 0;
};
struct State {
	Vector3r pos;
};
struct Body {
	shared_ptr<Shape> shape;
	shared_ptr<State> state = std::make_shared<State>();
	using id_t              = int;
	static std::map<int, shared_ptr<Body>>& all()
	{
		static std::map<int, shared_ptr<Body>> bodies;
		return bodies;
	}
	static shared_ptr<Body>& byId(int id, struct Scene* = nullptr) { return all()[id]; }
};
struct Cell {
	Vector3r intrShiftPos(int) { return {}; }
};
struct Scene {
	bool  isPeriodic = false;
	Cell* cell       = nullptr;
};
struct Material : Indexed { };
struct FrictMat : Material {
	Real frictionAngle = 0.5, poisson = 0.3;
};
struct IPhys : Indexed { };
struct FrictPhys : IPhys {
	Real     kn = 0, ks = 0, tangensOfFrictionAngle = 0;
	Vector3r normalForce, shearForce;
};
struct IGeom : Indexed { };
struct ScGeom : IGeom {
	Real      penetrationDepth = 0;
	Vector3r  normal, contactPoint, increment;
	Vector3r& rotate(Vector3r& v) const { return v; }
	Vector3r  shearIncrement() const { return increment; }
};
struct Interaction {
	int               one = 0, two = 1, cellDist = 0;
	shared_ptr<IPhys> phys;
	shared_ptr<IGeom> geom;
	int               getId1() const { return one; }
	int               getId2() const { return two; }
};
struct IPhysFunctor {
	virtual ~IPhysFunctor() { }
	Scene*       scene = nullptr;
	virtual void go(const shared_ptr<Material>&, const shared_ptr<Material>&, const shared_ptr<Interaction>&) = 0;
};
struct LawFunctor {
	virtual ~LawFunctor() { }
	Scene*       scene = nullptr;
	Vector3r     applied;
	virtual bool go(shared_ptr<IGeom>&, shared_ptr<IPhys>&, Interaction*) = 0;
	void         applyForceAtContactPoint(const Vector3r& force, const Vector3r&, int, const Vector3r&, int, const Vector3r&) { applied = force; }
};

} // namespace yade
