"""The head: a U-Net on splatted features that corrects the image."""
