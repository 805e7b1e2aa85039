"""`tkamb compare`: folders of results side by side on one axis."""
