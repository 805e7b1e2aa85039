"""`tkamb check`: what a scene gives and what it asks, before anything is computed."""
