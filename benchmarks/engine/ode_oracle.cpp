// The same robots and motion on libode's dWorldStep, as rcssserver3d sets it up: an independent oracle for exactness and speed.
// Reads a model and commands on standard input (see run.py), prints seconds inside the step and the final torso positions.
#include <ode/ode.h>

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

namespace {

struct Part {
  double mass, inertia[3], offset[3], anchor[3], axis[3], low, high;
  int parent, shape;
  double size[3];
};

dWorldID world;
dSpaceID space;
dGeomID ground;
dJointGroupID contacts;

void near_callback(void*, dGeomID a, dGeomID b) {
  if (a != ground && b != ground) return;  // the robot does not touch itself
  const dGeomID part = a == ground ? b : a;
  dContact contact[4];
  const int count = dCollide(part, ground, 4, &contact[0].geom, sizeof(dContact));
  for (int k = 0; k < count; ++k) {
    contact[k].surface.mode = dContactSoftERP | dContactSoftCFM | dContactSlip1 | dContactSlip2;
    contact[k].surface.mu = dInfinity;
    contact[k].surface.soft_erp = 0.4f;
    contact[k].surface.soft_cfm = 1e-4f;
    contact[k].surface.slip1 = contact[k].surface.slip2 = 5e-3f;
    dJointAttach(dJointCreateContact(world, contacts, &contact[k]), dGeomGetBody(part), nullptr);
  }
}

double number() {
  double x;
  if (std::scanf("%lf", &x) != 1) std::exit(2);
  return x;
}

}  // namespace

int main() {
  dInitODE2(0);
  const int parts = static_cast<int>(number()), cycles = static_cast<int>(number());
  const double height = number();
  world = dWorldCreate();
  space = dHashSpaceCreate(nullptr);
  ground = dCreatePlane(space, 0, 0, 1, 0);
  contacts = dJointGroupCreate(0);
  const double h = 0.02f;
  dWorldSetGravity(world, 0, 0, -9.81f);
  dWorldSetCFM(world, 1e-5f);
  dWorldSetContactSurfaceLayer(world, 0.001f);
  dWorldSetAutoDisableFlag(world, 1);
  std::vector<Part> table(parts);
  std::vector<dBodyID> bodies(parts);
  std::vector<dJointID> hinges(parts, nullptr);
  for (int i = 0; i < parts; ++i) {
    Part& p = table[i];
    p.mass = number();
    for (double& x : p.inertia) x = number();
    for (double& x : p.offset) x = number();
    p.parent = static_cast<int>(number());
    for (double& x : p.anchor) x = number();
    for (double& x : p.axis) x = number();
    p.low = number();
    p.high = number();
    p.shape = static_cast<int>(number());
    for (double& x : p.size) x = number();
    bodies[i] = dBodyCreate(world);
    dMass mass;
    dMassSetZero(&mass);
    mass.mass = p.mass;
    for (int c = 0; c < 3; ++c) mass.I[5 * c] = p.inertia[c];
    dBodySetMass(bodies[i], &mass);
    dBodySetPosition(bodies[i], p.offset[0], p.offset[1], p.offset[2] + height);
    dGeomID geom = nullptr;
    if (p.shape == 1) geom = dCreateBox(space, p.size[0], p.size[1], p.size[2]);
    if (p.shape == 2) geom = dCreateSphere(space, p.size[0]);
    if (p.shape == 3) geom = dCreateCapsule(space, p.size[0], p.size[1]);
    if (geom) dGeomSetBody(geom, bodies[i]);
    if (p.parent < 0) continue;
    const dJointID hinge = hinges[i] = dJointCreateHinge(world, nullptr);
    dJointAttach(hinge, bodies[i], bodies[p.parent]);
    dJointSetHingeAnchor(hinge, p.offset[0] + p.anchor[0], p.offset[1] + p.anchor[1], p.offset[2] + height + p.anchor[2]);
    dJointSetHingeAxis(hinge, p.axis[0], p.axis[1], p.axis[2]);
    dJointSetHingeParam(hinge, dParamLoStop, p.low);
    dJointSetHingeParam(hinge, dParamHiStop, p.high);
    dJointSetHingeParam(hinge, dParamFMax, 10);
    dJointSetHingeParam(hinge, dParamCFM, 1e-8f);
    dJointSetHingeParam(hinge, dParamStopCFM, 1e-8f);
    dJointSetHingeParam(hinge, dParamStopERP, 0.8f);
    dJointSetHingeParam(hinge, dParamBounce, 1);
    dJointSetHingeParam(hinge, dParamFudgeFactor, 1e-5f);
  }
  const int warm_up = static_cast<int>(number());
  double seconds = 0;
  for (int t = 0; t < cycles; ++t) {
    for (int i = 1; i < parts; ++i) {
      const double speed = static_cast<float>(number());
      const double angle = dJointGetHingeAngle(hinges[i]);
      if (angle < table[i].high && angle > table[i].low) dJointSetHingeParam(hinges[i], dParamVel, speed);
      if (speed != 0 && !dBodyIsEnabled(bodies[i])) dBodyEnable(bodies[i]);
    }
    const auto start = std::chrono::steady_clock::now();
    for (int i = 0; i < parts; ++i) {
      const dReal *v = dBodyGetLinearVel(bodies[i]), *w = dBodyGetAngularVel(bodies[i]);
      const float d = -0.01f;
      dBodyAddForce(bodies[i], d * float(v[0]), d * float(v[1]), d * float(v[2]));
      dBodyAddTorque(bodies[i], d * float(w[0]), d * float(w[1]), d * float(w[2]));
    }
    dSpaceCollide(space, nullptr, near_callback);
    dWorldStep(world, h);
    dJointGroupEmpty(contacts);
    if (t >= warm_up) seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    const dReal* x = dBodyGetPosition(bodies[0]);
    std::printf("%.17g %.17g %.17g\n", x[0], x[1], x[2]);
  }
  std::printf("%.9g\n", seconds);
  dCloseODE();
}
