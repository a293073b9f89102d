"""The SOG container: lossless WebP images and ``meta.json``. Takes an encoding plan; gives files of SOG 2, and back.
Reads version 1 and levels of detail as well. Needs no cameras and no renderer; the decoder needs no planner."""

from kissgs.io.containers import META_NAME

MEANS, QUATS, SCALES, SH0 = ("means_l.webp", "means_u.webp"), "quats.webp", "scales.webp", "sh0.webp"
SHN = ("shN_centroids.webp", "shN_labels.webp")

FILES = (META_NAME, *MEANS, QUATS, SCALES, SH0, *SHN)  # names of all files that a container may have

ENTRIES_PER_ROW = 64  # entries of the SH codebook in a row of its image
FIRST_TAG = 252  # alpha of a rotation whose largest component is w; 253 to 255 are x, y, z
