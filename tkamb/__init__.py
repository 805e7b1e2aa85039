"""tkamb: what happens inside a total knee replacement."""
