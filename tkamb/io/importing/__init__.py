"""`tkamb import`: a patient and a scene from an OpenSim model, a recording and meshes."""
