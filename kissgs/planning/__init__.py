"""The encoder's decisions: order, rotation forms, codebook, step sizes and levels. Takes a scene and its sensitivity;
returns an encoding plan. Writes no files and renders no images."""
