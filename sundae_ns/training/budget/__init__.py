"""Mode ``auto``: a search that cuts the field during training, as :mod:`sundae_ns.training.budget.search` decides.

Held-out training views judge; test views are never used. ``docs/options.md`` lists the phases. A budget in bytes or
primitives needs no search for their number, which then follows from it.
"""

from sundae_ns.training.budget.extension import BudgetSearch
from sundae_ns.training.budget.sizes import HEAD_SHARE, bytes_of, head_bytes, head_for

__all__ = ["HEAD_SHARE", "BudgetSearch", "bytes_of", "head_bytes", "head_for"]
