"""A contact model for tkamb from another package."""
