"""Momenta of a free robot with tissue over a step of MuJoCo.

Euler's method in MuJoCo takes axes and gyroscopic forces from the start of a step h, so that a free body loses momentum
in first order. Let m, P, x and L be mass, linear momentum, centre of mass and angular momentum about it of the bodies
of a tree and of the tissue, with its deformation and the velocity of that. A step under a force F with the torque T
about x, and gravity g, ends with

    P' = P + h (F + m g),    L' = L + h T,    x' = x + h P' / m,    Q' = Q exp(h (w + w') / 2)

by the velocity, the axes Q and the place of the root, spin w: tree and tissue are moved as if they were rigid. F and T
are MuJoCo's forces on the free joint, of the user, actuators and fluids too. Nothing of it depends on a velocity that
is added to everything. Where a constraint (contact, equality) acts on the free joint in a step, MuJoCo's is kept.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from softgrasp.fem.petsc import Array

PASSES = 2  # of velocity and axes, which need each other: the rest is of the fourth order in h
AT_REST = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # place and quaternion


class FreeFlight:
    """Momenta of the tree of a body whose root has a free joint; ``J`` of the body, with the root at rest in space."""

    def __init__(self, mujoco: Any, model: Any, body: int) -> None:
        self._mujoco, self._model, self._body = mujoco, model, body
        self._root = model.body_rootid[body]
        joint = model.body_jntadr[self._root]
        self.free, self.place = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        self._dofs, self._at = slice(self.free, self.free + 6), slice(self.place, self.place + 7)
        self._own, self.J = mujoco.MjData(model), np.zeros((6, model.nv))
        self.views = (self._own.M, self.J, self._own.xmat[body], self._own.qvel)
        self._rows, self._columns = np.repeat(np.arange(model.nv), model.M_rownnz), np.array(model.M_colind)

    @classmethod
    def of(cls, mujoco: Any, model: Any, body: int) -> FreeFlight | None:
        """None where the tree has another root, or its joint inertia or damping that is no rigid body's."""
        root = model.body_rootid[body]
        joint = model.body_jntadr[root]
        if not model.body_jntnum[root] or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
            return None
        dofs = slice(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + 6)
        odd = model.dof_armature[dofs].any() or model.dof_damping[dofs].any() or model.tendon_armature.any()
        return None if odd else cls(mujoco, model, body)

    def rest(self, data: Any) -> None:
        """The tree with its root at rest in the axes of space, in data of its own."""
        own = self._own
        own.qpos[:], own.qvel[:] = data.qpos, data.qvel
        own.qpos[self._at], own.qvel[self._dofs] = AT_REST, 0.0
        self._mujoco.mj_kinematics(self._model, own)
        self._mujoco.mj_comPos(self._model, own)
        self._mujoco.mj_crb(self._model, own)
        self._mujoco.mj_jacBody(self._model, own, self.J[:3], self.J[3:], self._body)

    def is_held(self, data: Any) -> bool:
        """Whether a constraint acted on the free joint."""
        return bool(data.qfrc_constraint[self._dofs].any())

    # ---- in NumPy; `step.c` has the same

    def _momenta(self, inertia: Array, moving: Array) -> tuple[Array, Array, Array]:
        """With the root at rest: mass matrix (6, 6), momenta about its origin (6,), centre of mass (3,).

        ``inertia`` (6, 6) and ``moving`` (6,) are the deformation's, about the origin of its body in the axes of it.
        """
        M = np.zeros((self._model.nv, self._model.nv))
        M[self._rows, self._columns] = M[self._columns, self._rows] = self._own.M
        Q = self._own.xmat[self._body].reshape(3, 3)
        J = np.concatenate([Q.T @ self.J[:3], Q.T @ self.J[3:]])
        mass = M[self._dofs, self._dofs] + J[:, self._dofs].T @ inertia @ J[:, self._dofs]
        p = M[self._dofs] @ self._own.qvel + J[:, self._dofs].T @ (inertia @ (J @ self._own.qvel) + moving)
        return mass, p, np.array([mass[1, 5], mass[2, 3], mass[0, 4]]) / mass[0, 0]

    def depart(self, data: Any, inertia: Array, moving: Array) -> None:
        """Keep what the tree has before a step."""
        mass, p, c = self._momenta(inertia, moving)
        R, v = data.xmat[self._root].reshape(3, 3).copy(), data.qvel[self._dofs]
        p = p + mass @ np.concatenate([v[:3] @ R, v[3:]])
        self._P, self._L, self._arm = R @ p[:3], R @ (p[3:] - np.cross(c, p[:3])), R @ c
        self._x, self._R, self._w = data.qpos[self._at][:3] + self._arm, R, v[3:].copy()
        self._q = data.qpos[self._at][3:].copy()
        self._mujoco.mju_normalize4(self._q)

    def keep(self, data: Any, h: float, gravity: Array, inertia: Array, moving: Array, given: Array) -> None:
        """Set velocity, axes and place of the root after a step in which the tissue gave ``given`` (nv,)."""
        mass, rest, c = self._momenta(inertia, moving)
        force = (data.qfrc_smooth + data.qfrc_bias - given)[self._dofs]  # MuJoCo's bias has the weight, too
        P = self._P + h * (force[:3] + mass[0, 0] * gravity)
        L = self._L + h * (self._R @ force[3:] - np.cross(self._arm, force[:3]))

        def reached(R: Array) -> Array:
            p = R.T @ P
            return np.linalg.solve(mass, np.concatenate([p, R.T @ L + np.cross(c, p)]) - rest)

        q = data.qpos[self._at][3:].copy()
        for _ in range(PASSES):
            w, q = reached(_matrix(self._mujoco, q))[3:], self._q.copy()
            self._mujoco.mju_quatIntegrate(q, (self._w + w) / 2, h)
            self._mujoco.mju_normalize4(q)
        R = _matrix(self._mujoco, q)
        xi = reached(R)
        data.qpos[self._at] = [*(self._x + h * P / mass[0, 0] - R @ c), *q]
        data.qvel[self._dofs] = [*(R @ xi[:3]), *xi[3:]]


def _matrix(mujoco: Any, q: Array) -> Array:
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, q)
    return R.reshape(3, 3)
