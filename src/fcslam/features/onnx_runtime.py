"""Loads ONNX Runtime without telemetry.

On Linux, the official builds since 1.29 send telemetry and keep an identifier and a database in
``~/.cache/Microsoft/DeveloperTools`` (https://github.com/microsoft/onnxruntime/pull/27379).
``disable_telemetry_events`` stops the events, but only the environment variable prevents the files.
"""

import os
from typing import Any


def load_onnx_runtime() -> Any:
    """Import ``onnxruntime``; call this before any other import of it."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    onnxruntime.disable_telemetry_events()  # in case another module imported it before
    return onnxruntime
