"""What a recording can show before any fit: see :func:`physworld.check.run.check`."""

from physworld.check.report import document
from physworld.check.run import CheckConfig, CheckResult, check
from physworld.check.visibility import INVISIBLE, LARGE, VISIBLE

__all__ = ["INVISIBLE", "LARGE", "VISIBLE", "CheckConfig", "CheckResult", "check", "document"]
