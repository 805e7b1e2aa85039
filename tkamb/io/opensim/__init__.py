"""Reading and evaluation of OpenSim models without OpenSim.

- `tkamb.io.opensim.read`: `read_osim(path)` returns an `OpenSimModel`.
- `tkamb.io.opensim.model`: the data of an `OpenSimModel`.
- `tkamb.io.opensim.kinematics`: `Kinematics(model).poses(q)` for many coordinate sets
  at once; `.motion(q).points(bodies, locations)` for points with their Jacobians.
- `tkamb.io.opensim.paths`: `LineSet(kinematics).at(q)` for lengths and moment arms.
- `tkamb.io.opensim.motion`: `inverse_dynamics(...)` for the generalised forces of a motion.
"""
