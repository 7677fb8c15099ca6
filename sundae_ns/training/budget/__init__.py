"""Mode ``auto``: a search that cuts the field during training, as :mod:`sundae_ns.training.budget.search` decides.

Held-out training views judge; test views are never used. After the warm-up:

1. The field is trained on at its SH degree, and for as long at lower ones. The lowest degree that held-out views accept is
   kept for the whole scene.
2. The field is cut, trained, evaluated and cut again, with the head disabled.
3. If a head is small beside the remaining field, the largest such head is enabled, with features that are small beside a
   primitive, and the cuts go on. The head stays only if field, features and head together are then smaller.
4. Primitives whose colour hardly depends on the view get view-independent colours.

A budget in bytes or primitives replaces 2 and 3: the number of primitives then follows from it.
"""

from sundae_ns.training.budget.extension import BudgetSearch
from sundae_ns.training.budget.sizes import HEAD_SHARE, bytes_of, head_bytes, head_for

__all__ = ["HEAD_SHARE", "BudgetSearch", "bytes_of", "head_bytes", "head_for"]
