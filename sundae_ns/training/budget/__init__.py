"""Mode ``auto``: a search that cuts the field during training, as :mod:`sundae_ns.training.budget.search` decides.

Held-out training views judge; test views are never used. ``docs/options.md`` lists the phases. A budget in bytes or
primitives needs no search for their number, which then follows from it.
"""

from sundae_ns.training.budget.extension import BudgetSearch

__all__ = ["BudgetSearch"]
