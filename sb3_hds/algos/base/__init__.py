"""What all algorithms share: construction, policies, files, the way in through SB3."""

from sb3_hds.lazy import postpone

# SBX's base class is all that is needed of it here; its algorithms import TensorFlow Probability.
postpone("sbx")
