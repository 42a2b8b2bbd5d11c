"""System identification: what measured data say about a twin."""

from sb3_hds.sysid.belief.belief import write_randomisation
from sb3_hds.sysid.design import Limits, NextExperiment
from sb3_hds.sysid.diagnosis.diagnose import diagnose
from sb3_hds.sysid.estimation.calibrate import calibrate
from sb3_hds.sysid.estimation.residual_force import Residual, fit_residual
from sb3_hds.sysid.estimation.results import Estimate, Fit
from sb3_hds.sysid.reporting.diagnosis import Diagnosis
from sb3_hds.sysid.reporting.figures import plot_belief
from sb3_hds.sysid.reporting.finding import Finding

__all__ = [
    "Diagnosis",
    "Estimate",
    "Finding",
    "Fit",
    "Limits",
    "NextExperiment",
    "Residual",
    "calibrate",
    "diagnose",
    "fit_residual",
    "plot_belief",
    "write_randomisation",
]
