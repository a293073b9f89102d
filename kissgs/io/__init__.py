"""Reading and writing of scene files. Takes files or bytes; gives Splats, and back."""
