"""Whether figures are written as PDF too, beside the PNG; apart from Matplotlib, for the command line sets it."""

from contextvars import ContextVar

PDF: ContextVar[bool] = ContextVar("PDF", default=False)
