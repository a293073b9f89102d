"""Settings, problem types, schemas and tables, shared by all other parts of the service."""
