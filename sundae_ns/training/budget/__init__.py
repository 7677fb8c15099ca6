"""The budget finds itself: cuts the field during training as :mod:`sundae_ns.training.budget.search` decides.

Held-back training views judge; test views are never looked at. After the warm-up:

1. the field is trained on with all bands of its harmonics, and for as long with fewer: those that held-back views do not
   miss go, for the whole scene;
2. the field is cut, trained, looked at, and cut again, on its base colours alone;
3. where a network that corrects them is small beside the field that came out, the largest such joins, with features as
   wide as are small beside a primitive, and the field is cut on; it stays only if field, features and network together
   are then smaller;
4. primitives whose colour does not depend on the view lose their bands above 0.

A budget in bytes or primitives takes the place of 2 and 3: then the count follows from it.
"""

from sundae_ns.training.budget.driver import Budget
from sundae_ns.training.budget.sizes import HEAD_SHARE, bytes_of, head_bytes, head_for

__all__ = ["HEAD_SHARE", "Budget", "bytes_of", "head_bytes", "head_for"]
