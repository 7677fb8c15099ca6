"""From a field to images: views, one splatting pass, the head, contribution, and recorded frames."""
