"""What everything else is made of: scenes, errors, progress, threads, array types. Imports no other package."""
