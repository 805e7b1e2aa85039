"""Released knee coordinates: the pose at which contact, ligaments and muscles balance."""
