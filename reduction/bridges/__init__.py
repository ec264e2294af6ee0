"""Reduced tissue inside the simulators of others."""

from softgrasp.reduction.bridges.mujoco import MujocoTissue as MujocoTissue
from softgrasp.reduction.bridges.mujoco import mujoco_body as mujoco_body
from softgrasp.reduction.bridges.mujoco import write_mujoco as write_mujoco
