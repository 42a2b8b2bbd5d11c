"""
Policies on a robot: an ONNX file that needs no learning library, and a header of C.

Names are imported on first use: running a file imports neither jax nor torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_hds.deploy.c_header import Header, export_c
    from sb3_hds.deploy.export import Exported, export_onnx
    from sb3_hds.deploy.onnx_policy import OnnxPolicy
    from sb3_hds.deploy.policy_function import Memory, PolicyFunction
    from sb3_hds.deploy.run import Latencies, run_policy

__all__ = [
    "Exported",
    "Header",
    "Latencies",
    "Memory",
    "OnnxPolicy",
    "PolicyFunction",
    "export_c",
    "export_onnx",
    "run_policy",
]

_MODULES = {
    "Exported": "export",
    "Header": "c_header",
    "Latencies": "run",
    "Memory": "policy_function",
    "OnnxPolicy": "onnx_policy",
    "PolicyFunction": "policy_function",
    "export_c": "c_header",
    "export_onnx": "export",
    "run_policy": "run",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
