"""What a recording can show before any fit: see :func:`physworld.trace.check.run.check`."""

from physworld.trace.check.report import document
from physworld.trace.check.run import CheckConfig, CheckResult, check
from physworld.trace.check.visibility import INVISIBLE, LARGE, VISIBLE

__all__ = ["INVISIBLE", "LARGE", "VISIBLE", "CheckConfig", "CheckResult", "check", "document"]
