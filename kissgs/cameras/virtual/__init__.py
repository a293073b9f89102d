"""Virtual cameras: cameras placed by kissgs, for a scene without a capture or beside one.

Takes Splats, with the numbers, image sizes and seeds that the caller sets. Returns Views, lists of Camera, an Orbit, or
WeightedCameras for the sensitivity. Renders thumbnails to score cameras; never uses those that ``kissgs evaluate``
draws.
"""
