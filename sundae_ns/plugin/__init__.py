"""All that needs nerfstudio."""
