"""A small container, and variants with other metadata."""

import json

import numpy as np
import pytest
import yaml

from helpers.codec_scenes import random_scene
from kissgs import InvalidContainerError, Settings, compress, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt import CHECKSUM

FILES = compress(random_scene(70, 2, seed=4), settings=Settings.from_preset("fast")).files


def document():
    return yaml.safe_load(FILES["container_meta.yaml"])


def with_yaml(text):
    """Return the files without ``meta.json``, with this text as YAML."""
    files = {**FILES, "container_meta.yaml": text if isinstance(text, bytes) else text.encode()}
    del files["meta.json"]
    return files


def with_document(changed):
    """Return the files with this document as YAML, without a checksum, as from another encoder."""
    changed = {key: value for key, value in changed.items() if key != CHECKSUM}
    return with_yaml(yaml.safe_dump(changed))


def with_json(change):
    """Return the files without YAML, with ``meta.json`` changed by a function and without its checksum."""
    meta = json.loads(FILES["meta.json"])
    del meta[CHECKSUM]
    change(meta)
    files = {**FILES, "meta.json": json.dumps(meta).encode()}
    del files["container_meta.yaml"]
    return files


def quantize_of(changed, field):
    """Return the part of a document with the range of ``field``."""
    op = next(op for op in changed["ops"] if op["input_fields"] == [field])
    return op["transforms"][0]["simple_quantize"]


def refusal(files, kind=InvalidContainerError):
    with pytest.raises(kind) as caught:
        decompress(files)
    return str(caught.value)


def assert_same(found, wanted=None):
    wanted = wanted or decompress(FILES)
    assert all(np.array_equal(getattr(found, name), getattr(wanted, name)) for name in ATTRIBUTES)
