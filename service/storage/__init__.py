"""Jobs at rest: the database, the data folder, and that both belong together."""
