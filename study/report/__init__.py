"""The page of a result: sections, equations, files."""

from typing import TYPE_CHECKING

from softgrasp._face import face
from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py

if TYPE_CHECKING:
    from softgrasp.study.report.document import (
        SHOWN,
        Columns,
        Page,
        Section,
        Share,
        Table,
        captioned,
        entry,
        in_words,
        percent,
        seconds_text,
        show_sections,
        table_of,
    )
    from softgrasp.study.report.equation import control_equation
    from softgrasp.study.report.files import to_json, write_json, write_scene
    from softgrasp.study.report.origin import command_line
    from softgrasp.study.report.page import EQUATION, of_scene, write_report
else:
    __getattr__, __dir__ = face(__name__)
