"""The encoder's decisions: order, rotation forms, codebook, step sizes and levels.

Takes a scene and the sensitivity of its images; gives an encoding plan. Writes nothing and renders nothing.
"""
