"""The HTTP service over the public API of kissgs: upload a ``.ply``, follow the job, download the container."""
