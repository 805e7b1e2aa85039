"""Published numbers as data, and what tkamb makes of the same cases."""
