"""The page of a result: sections, equations, files."""

from typing import TYPE_CHECKING

from softgrasp._face import face
from softgrasp.fem import _stack as _stack  # threads and MPI before numpy and petsc4py

if TYPE_CHECKING:
    from softgrasp.study.report.files import to_json, write_json, write_scene
    from softgrasp.study.report.page import EQUATION, SHOWN, Section, captioned, of_scene, write_report
    from softgrasp.study.report.tables import Columns, Table, entry, listed, percent, show_sections, table_of
else:
    __getattr__, __dir__ = face(__name__)
