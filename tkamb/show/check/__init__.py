"""`tkamb check`: content of a scene and questions about it, before anything is computed."""
