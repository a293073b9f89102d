"""Persistence of jobs: the database, the data folder, and the binding between both."""
