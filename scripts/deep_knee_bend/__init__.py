"""How models/deep_knee_bend is made: one idea per module, every number in dimensions."""
