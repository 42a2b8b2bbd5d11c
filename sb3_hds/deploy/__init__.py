"""
Policies on a robot: an ONNX file that needs no learning library, and a C header.

Names are imported on first use: running a file imports neither jax nor torch.
"""

from sb3_hds.lazy import lazy_imports

with lazy_imports(__name__):
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
