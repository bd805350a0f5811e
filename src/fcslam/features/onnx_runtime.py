"""ONNX Runtime as this project uses it: it tells nobody of its use.

On Linux its official builds report use to their maker, and keep an identifier and a database for it in
``~/.cache/Microsoft/DeveloperTools`` (since 1.29; https://github.com/microsoft/onnxruntime/pull/27379). Reports can be
stopped later by ``disable_telemetry_events``; files are made as soon as it is loaded, unless the environment says no.
"""

import os
from typing import Any


def load_onnx_runtime() -> Any:
    """The module ``onnxruntime``; what is imported of it by others has to be imported after this."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    onnxruntime.disable_telemetry_events()  # had somebody else loaded it before
    return onnxruntime
