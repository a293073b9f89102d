"""Requests and answers: the application, its routes, uploads and files."""
