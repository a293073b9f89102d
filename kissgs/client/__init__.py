"""Client of a kissgs service: uploads scenes, follows jobs, downloads containers."""
