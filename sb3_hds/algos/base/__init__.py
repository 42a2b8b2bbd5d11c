"""What all algorithms share: construction, configs, policies, saved files, SB3's ``learn``."""

from sb3_hds.lazy import postpone

# Only SBX's base class is needed; its algorithms import TensorFlow Probability.
postpone("sbx")
