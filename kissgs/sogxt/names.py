"""Names of the files in a container."""

YAML_NAME, JSON_NAME, SCENE_NAME = "container_meta.yaml", "meta.json", "scene.json"

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
