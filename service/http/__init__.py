"""HTTP interface: the application, its routes, uploads and file downloads."""
