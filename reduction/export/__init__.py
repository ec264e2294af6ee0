"""Reduced models as C99 for other programs: the midpoint step, tunable in the material, and an FMU around it."""

from softgrasp.reduction.export.fmu import write_fmu as write_fmu
from softgrasp.reduction.export.plant import write_c as write_c
