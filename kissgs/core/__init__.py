"""Basic types: scenes, sensitivity, errors, progress, threads, array types. Imports no other package of kissgs."""
