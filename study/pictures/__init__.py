"""Pictures that several commands draw."""

from typing import TYPE_CHECKING

from softgrasp._face import face

if TYPE_CHECKING:
    from softgrasp.study.pictures.animation import film, gif_bytes, move_bytes, timing, write_gif
    from softgrasp.study.pictures.background import draw_in_background
    from softgrasp.study.pictures.body import figure_move
    from softgrasp.study.pictures.frames import Frames
    from softgrasp.study.pictures.loop import Poles, figure_decay, histories
    from softgrasp.study.pictures.obstacles import draw_obstacle
    from softgrasp.study.pictures.shapes import hand_polygons, hands_at, move_steps, seen, shadow, speed_up
    from softgrasp.study.pictures.style import (
        BLUE,
        COLUMN,
        CYCLE,
        FULL,
        GREEN,
        HAND,
        ORANGE,
        OUTLINE,
        PURPLE,
        UNSTABLE,
        WIDTH,
        colour_map,
        few_ticks,
        length_unit,
        paper_style,
        save,
    )
else:
    __getattr__, __dir__ = face(__name__)
