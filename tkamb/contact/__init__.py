"""Contact models: given a pose of the femoral component in the insert, what pressure?"""
