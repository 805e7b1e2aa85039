"""The commands of `tkamb` parse arguments, call the code that computes, and print results."""
