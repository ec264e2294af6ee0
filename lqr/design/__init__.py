"""The feedback of a scene: its Riccati problem, the optimal gain, reduced gains by order, the small controller.

The one part of ``lqr`` that sees scenes and models.
"""

from softgrasp.lqr.design.controller import make_controller as make_controller
from softgrasp.lqr.design.feedback import Design as Design
from softgrasp.lqr.design.feedback import design as design
from softgrasp.lqr.design.orders import reduce_gains as reduce_gains
from softgrasp.lqr.design.scene import problem as problem
