"""From the command line to a command: session, standard streams, other programs, diagnosis."""

from typing import TYPE_CHECKING

from softgrasp._face import face

if TYPE_CHECKING:
    from softgrasp.study.shell.folder import claim, folder_lock, read_result
    from softgrasp.study.shell.session import Flags, Session, list_files, show_warnings
    from softgrasp.study.shell.timing import (
        RepeatableRun,
        interleave,
        median_processor_seconds,
        median_seconds,
        medians,
        power_law,
        processor_seconds,
        repeated,
        rotated,
        timed,
    )
else:
    __getattr__, __dir__ = face(__name__)
