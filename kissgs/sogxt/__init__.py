"""The SOG-XT container: nine lossless images and three metadata files. Takes an encoding plan; gives files, and back.
Needs no cameras and no renderer."""

YAML_NAME, JSON_NAME, SCENE_NAME = "container_meta.yaml", "meta.json", "scene.json"

FORMAT_NAME = "sog-xt"  # name of the format in meta.json
CHECKSUM = "kissgs_crc32"  # key of the metadata's checksum, outside kissgs, so that it shows a loss of that block

PLANES = (
    *("active_mask.webp", "means_bytes_0.webp", "means_bytes_1.webp", "opacities.webp", "scales.webp"),
    *("quaternions.webp", "f_dc.webp", "f_rest_labels.webp", "f_rest_centroids.webp"),
)

FILES = (YAML_NAME, JSON_NAME, SCENE_NAME, *PLANES)  # names of all files of a container
