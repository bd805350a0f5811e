"""Bodies for schemathesis where no schema describes the bytes: files from the folder named by BODIES."""

import os
from pathlib import Path

import schemathesis
from hypothesis import strategies as st

for path in sorted(Path(os.environ["BODIES"]).iterdir()):
    schemathesis.openapi.media_type(f"application/{path.name}", st.just(path.read_bytes()))
