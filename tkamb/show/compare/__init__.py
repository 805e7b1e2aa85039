"""`tkamb compare`: folders of results beside each other on one axis."""
