"""Names of the files in a container, and of a key in two of them."""

YAML_NAME, JSON_NAME, SCENE_NAME = "container_meta.yaml", "meta.json", "scene.json"

CHECKSUM = "kissgs_crc32"
"""Key of the metadata's checksum. It stands outside ``kissgs``, so that it tells if that block is lost."""

PLANES = (
    "active_mask.webp",
    "means_bytes_0.webp",
    "means_bytes_1.webp",
    "opacities.webp",
    "scales.webp",
    "quaternions.webp",
    "f_dc.webp",
    "f_rest_labels.webp",
    "f_rest_centroids.webp",
)

FILES = (YAML_NAME, JSON_NAME, SCENE_NAME, *PLANES)
