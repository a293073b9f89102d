"""Reading and writing of scene files, one module per format. Takes files or bytes; gives Splats, and back."""
