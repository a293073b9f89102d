"""Scenes for schemathesis, which cannot derive them from a schema; loaded by SCHEMATHESIS_HOOKS."""

import schemathesis
from hypothesis import strategies as st

from helpers.service import SMALL

SCENES = st.one_of(st.just(SMALL), st.just(SMALL[:-1]), st.binary(max_size=100))

schemathesis.openapi.media_type("application/octet-stream", SCENES)
