"""Reduced bases and reduced models; imports fem only, of matrices and vectors, without DOLFINx."""

from typing import TYPE_CHECKING

from softgrasp._face import face
from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py

if TYPE_CHECKING:
    from softgrasp.reduction.bases import registry
    from softgrasp.reduction.bases.basis import Basis, ReductionError
    from softgrasp.reduction.bases.engines import ENGINES
    from softgrasp.reduction.bases.registry import METHODS, OWN_METHODS, PAPER_METHODS, Method, find_method
    from softgrasp.reduction.bases.states import states_of
    from softgrasp.reduction.bases.truncation import Truncation
    from softgrasp.reduction.certified.archive import load_certified, save_certified
    from softgrasp.reduction.certified.certificate import NORMS, Certificate
    from softgrasp.reduction.certified.greedy import Greedy
    from softgrasp.reduction.certified.model import CertifiedModel, ParameterDomain
    from softgrasp.reduction.certified.motion import Drive, Materials
    from softgrasp.reduction.certified.trainer import Validation
    from softgrasp.reduction.certified.validation import TestError, measured_error
    from softgrasp.reduction.errors import ModelComparison
    from softgrasp.reduction.model import ReducedModel
    from softgrasp.reduction.online import ReducedTrajectory, Stepper, prepared
    from softgrasp.reduction.origin import differing, origin_of
    from softgrasp.reduction.parameters import grid_of, materials_at, outside, run_at, thinned
    from softgrasp.reduction.reduce import project_scene, reduce_linear
    from softgrasp.reduction.replay import FullRun, errors_linear, full_run, replay_linear
    from softgrasp.reduction.strain.model import StrainModel, TrainingDomain
    from softgrasp.reduction.system import ModelError
else:
    __getattr__, __dir__ = face(__name__)
