"""ns-train."""
import sys
from nerfstudio.scripts.train import entrypoint
if __name__=="__main__":
    sys.argv[0]="ns-train"; entrypoint()
