"""Requests of the UM-Bridge protocol 1.0 [SRD23] to a certified model, and their answers; no network here."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softgrasp.fem import Array, SceneError
from softgrasp.fem.errors import SoftgraspError, shortened
from softgrasp.reduction import CertifiedModel, Drive, Materials
from softgrasp.reduction.certified.certificate import CertifiedRun
from softgrasp.reduction.gradient.reduced import sensitivities
from softgrasp.reduction.online import run

KEYS = {"lambda": "lam", "mu": "mu", "rho": "rho"}
MODELS = ("forward", "bound")
SUPPORT = {
    "forward": {"Evaluate": True, "Gradient": True, "ApplyJacobian": True, "ApplyHessian": False},
    "bound": {"Evaluate": True, "Gradient": False, "ApplyJacobian": False, "ApplyHessian": False},
}
NEEDED = {"/Evaluate": "Evaluate", "/Gradient": "Gradient", "/ApplyJacobian": "ApplyJacobian"}
POSTED = ("/InputSizes", "/OutputSizes", "/ModelInfo", "/ApplyHessian", *NEEDED)
CONFIG = ("tolerance", "allow")


class RequestError(Exception):
    """A request that is refused: a kind of the protocol, one sentence, and the HTTP status."""

    def __init__(self, kind: str, text: str, status: int = 400) -> None:
        super().__init__(text)
        self.kind, self.status = kind, status


def allowed(path: str) -> tuple[str, ...]:
    """Methods of HTTP that a path accepts; all methods of the server where there is no such path."""
    return ("POST",) if path in POSTED else ("GET", "POST")


@dataclass
class Served:
    """A certified model behind the protocol: "forward" are its outputs over time, "bound" their errors.

    The errors are those of the reduction, proved unless the model was trained for an estimate; each answer says which.

    Input is one vector of the parameters ``inputs`` [Pa, kg/m3] of the first layer; other layers keep their ratios to
    it. Output is one vector of (steps + 1) x p numbers, all outputs of the first instant first [m, rad].
    """

    model: CertifiedModel  # what is asked
    drive: Drive  # motion of the hand
    inputs: tuple[str, ...] = ("lambda", "mu")  # parameters that vary; the others are those of the model

    @property
    def size(self) -> int:
        """Length of the output vector."""
        return (self.drive.steps + 1) * len(self.model.fine.outputs.names)

    def answer(self, method: str, path: str, body: Any) -> tuple[int, dict[str, Any]]:
        """Status and JSON of one request."""
        try:
            return 200, self._answer(method, path, body)
        except RequestError as error:
            return error.status, {"error": {"type": error.kind, "message": str(error)}}
        except SoftgraspError as error:
            return 400, {"error": {"type": "InvalidInput", "message": str(error)}}

    def _answer(self, method: str, path: str, body: Any) -> dict[str, Any]:
        if method not in (methods := allowed(path)):
            words = " or ".join(methods)
            raise RequestError("UnsupportedFeature", f"{method} {shortened(path)}: the method must be {words}", 405)
        if path == "/Info":
            return {"protocolVersion": 1.0, "models": list(MODELS)}
        if path not in POSTED:
            raise RequestError("UnsupportedFeature", f"{method} {shortened(path)} is not part of the protocol", 404)
        name = body.get("name") if isinstance(body, dict) else None
        if name not in MODELS:
            raise RequestError("ModelNotFound", f"the models are {' and '.join(MODELS)}, not {shortened(str(name))}")
        config = self._config(body.get("config") or {})
        if path == "/InputSizes":
            return {"inputSizes": [len(self.inputs)]}
        if path == "/OutputSizes":
            return {"outputSizes": [self.size]}
        if path == "/ModelInfo":
            return {"support": SUPPORT[name]}
        if not SUPPORT[name].get(NEEDED.get(path, ""), False):
            raise RequestError("UnsupportedFeature", f"model {name} has no {path[1:]}")
        materials = self._materials(_vector(body.get("input"), len(self.inputs), "input", nested=True))
        if path == "/Evaluate":
            found = self._run(materials, config)
            values = found.trajectory.outputs if name == "forward" else found.certificate.outputs.values
            if not np.isfinite(values).all():  # JSON has no such numbers
                raise RequestError("InvalidInput", f"model {name} has no finite answer for this material")
            return {"output": [values.ravel().tolist()], "bound": found.certificate.outputs.kind}
        for key in ("outWrt", "inWrt"):
            if body.get(key, 0) != 0:
                raise RequestError("InvalidInput", f"{key} must be 0: there is one vector of inputs and one of outputs")
        if path == "/Gradient":
            sens = _vector(body.get("sens"), self.size, "sens")
            return {"output": (self._slopes(materials, config) @ sens).tolist()}
        vec = _vector(body.get("vec"), len(self.inputs), "vec")
        return {"output": (vec @ self._slopes(materials, config)).tolist()}

    def _config(self, config: Any) -> dict[str, Any]:
        if not isinstance(config, dict) or set(config) - set(CONFIG):
            raise RequestError("InvalidInput", f"config has the keys {' and '.join(CONFIG)} alone")
        tolerance = config.get("tolerance")
        if tolerance is not None and not (_is_number(tolerance) and tolerance > 0):
            raise RequestError("InvalidInput", "config.tolerance must be a relative error > 0, such as 1e-2")
        if not isinstance(config.get("allow", False), bool):
            raise RequestError("InvalidInput", "config.allow must be true or false")
        return config

    def _materials(self, values: Array) -> Materials:
        own = self.model.fine.materials[0]
        given = {key: getattr(own, field) for key, field in KEYS.items()}
        given.update(zip(self.inputs, values.tolist(), strict=True))
        lam, mu, rho = (given[key] for key in KEYS)
        least = -2 * mu / self.model.norms.dimension
        if not (mu > 0 and rho > 0 and lam > least):
            raise SceneError(
                f"lambda = {lam:g}, mu = {mu:g}, rho = {rho:g} is no material; mu and rho must be positive, and lambda "
                f"above {least:g}"
            )
        return self.model.materials(lam, mu, rho)

    @property
    def bounds_are(self) -> str:
        """What "bound" answers, in words: a model trained for an estimate proves nothing."""
        return "estimated errors, not proofs" if self.model.certify == "estimate" else "proved errors"

    def _run(self, materials: Materials, config: dict[str, Any]) -> CertifiedRun:
        """The run with its certificate. Raises ToleranceError: the error is above the tolerance."""
        return self.model.run(
            materials, self.drive, tolerance=config.get("tolerance"), allow=config.get("allow", False)
        )

    def _slopes(self, materials: Materials, config: dict[str, Any]) -> Array:
        """dy/dinputs, (inputs, (steps + 1) p), of the reduced run, after the run itself was accepted."""
        self._run(materials, config)
        rom, drive = self.model.coarse, self.drive
        system = rom.at(materials)
        start = system.equilibrium() if drive.start == "equilibrium" else None
        answer = run(system, drive.dt, drive.force, drive.hand, start)
        others, steps = [], []
        for key in self.inputs:  # affine in each: any step is exact
            field = KEYS[key]
            steps.append(abs(getattr(materials[0], field)) + (materials[0].mu if field == "lam" else 0.0))
            share = steps[-1] / getattr(self.model.fine.materials[0], field)
            layers = zip(materials, self.model.fine.materials, strict=True)
            others.append(
                rom.at(tuple(replace(m, **{field: getattr(m, field) + share * getattr(o, field)}) for m, o in layers))
            )
        slopes = sensitivities(system, others, answer, driven=drive.hand is not None)
        return np.asarray(slopes.reshape(len(self.inputs), -1) / np.array(steps)[:, None])


def _is_number(x: Any) -> bool:
    try:
        return isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x)
    except OverflowError:  # an integer above the largest float
        return False


def _vector(given: Any, size: int, what: str, nested: bool = False) -> Array:
    """Numbers of a request, (size,). Raises RequestError: they are not that."""
    if nested:
        if not (isinstance(given, list) and len(given) == 1):
            raise RequestError("InvalidInput", f"{what} must be a list of one list")
        given = given[0]
    if not (isinstance(given, list) and len(given) == size and all(map(_is_number, given))):
        found = f"{len(given)} entries" if isinstance(given, list) else type(given).__name__
        raise RequestError("InvalidInput", f"{what} must have {size} finite numbers; it has {found}")
    return np.array(given, dtype=float)
