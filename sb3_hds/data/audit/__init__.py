"""Data quality checks that need no physics: one file for each kind of defect."""

from sb3_hds.data.audit.audit import audit
from sb3_hds.data.audit.finding import Finding
from sb3_hds.data.audit.results import Audit

__all__ = ["Audit", "Finding", "audit"]
