"""Evaluation: two scenes, and optionally views with photographs -> metrics of images and errors of stored values.

Evaluation cameras are drawn at random and share nothing with the encoder's cameras. Results can be written as JSON or
as one HTML page.
"""
