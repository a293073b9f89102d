"""Settings, problems, schemas and tables of the service: what every other part uses."""
