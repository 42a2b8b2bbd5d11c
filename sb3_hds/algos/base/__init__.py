"""What all algorithms share: construction, policies, files, the way in through SB3."""
