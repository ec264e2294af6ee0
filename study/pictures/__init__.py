"""Pictures that several commands draw."""

from contextvars import ContextVar

PDF: ContextVar[bool] = ContextVar("PDF", default=False)  # write figures as PDF too, beside the PNG
