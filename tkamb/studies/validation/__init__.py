"""Published numbers as data, and tkamb's results for the same cases."""
