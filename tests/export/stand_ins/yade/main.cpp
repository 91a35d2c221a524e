// Plays a sphere against a sphere and a wall, each as first body once, through the functors; prints force and header's.
#include <cstdio>

#include <pkg/dem/MccLaw.hpp>

using namespace yade;

int main()
{
	const double path[] = { 0.0, 1e-5, 2e-5, 1.99e-5, 1.95e-5, 1e-5, 3e-5 };
	auto         small = std::make_shared<Sphere>(), large = std::make_shared<Sphere>();
	small->radius = 60e-6;
	large->radius = 90e-6;
	auto hard     = std::make_shared<MccMat>();
	hard->C1 *= 1.5;
	const shared_ptr<Material> soft = std::make_shared<MccMat>(), materials[] = { hard, soft };
	const mcc_law              law = MCC_LAW_CALIBRATED;
	mcc_law                    other = law;
	other.C1                         = static_cast<double>(hard->C1);
	const mcc_contact i = mcc_half_contact(&other, 120e-6, 120e-6, 120e-6), j = mcc_half_contact(&law, 180e-6, 180e-6, 180e-6);
	for (int kind = 0; kind < 3; kind++) { // a pair, a wall as second and as first body
		Scene scene;
		Body::all()[0]        = std::make_shared<Body>();
		Body::all()[1]        = std::make_shared<Body>();
		const int first       = kind == 2;
		Body::byId(first)->shape     = small;
		Body::byId(1 - first)->shape = kind == 0 ? shared_ptr<Shape>(large) : std::make_shared<Shape>();
		auto interaction      = std::make_shared<Interaction>();
		Ip2_MccMat_MccMat_MccPhys ip2;
		Law2_ScGeom_MccPhys_Mcc   law2;
		ip2.scene = law2.scene = &scene;
		ip2.go(materials[first], materials[1 - first], interaction);
		auto geometry    = std::make_shared<ScGeom>();
		geometry->normal = Vector3r(0, 0, 1);
		shared_ptr<IGeom> geom = geometry;
		double            x_max = 0;
		for (double x : path) {
			const mcc_response want = mcc_pair_step(&i, kind ? nullptr : &j, x_max, x);
			x_max                   = want.x_max;
			geometry->penetrationDepth = x;
			geometry->increment = Vector3r(1.0, 0, 0); // slides: friction is the limit
			if (!law2.go(geom, interaction->phys, interaction.get())) return 1;
			const double friction = std::tan(0.5) * want.force;
			std::printf("%.17g %.17g %.17g %.17g\n", -law2.applied.z, want.force, law2.applied.x, friction);
		}
		geometry->penetrationDepth = -1e-9;
		if (law2.go(geom, interaction->phys, interaction.get())) return 1;
	}
	return 0;
}
