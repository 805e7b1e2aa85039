"""OpenSim models without OpenSim: read, posed, their muscles' paths measured.

- `tkamb.io.opensim.read`: `read_osim(path)` returns an `OpenSimModel`.
- `tkamb.io.opensim.model`: what that holds.
- `tkamb.io.opensim.kinematics`: `Kinematics(model).poses(q)`, for many poses at once;
  `.motion(q).points(bodies, locations)` for points with their Jacobians.
- `tkamb.io.opensim.paths`: `LineSet(kinematics).at(q)` for lengths and moment arms.
- `tkamb.io.opensim.motion`: the generalised forces of a motion.
"""
