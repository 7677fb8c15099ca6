"""Make the console scripts of nerfstudio and of this package in /opt/site/bin, which pip leaves out with --target."""
import configparser, glob, os
for entry in glob.glob("/opt/site/nerfstudio-*.dist-info/entry_points.txt") + glob.glob("/opt/site/sundae_ns-*.dist-info/entry_points.txt"):
    found = configparser.ConfigParser(); found.optionxform = str; found.read(entry)
    os.makedirs("/opt/site/bin", exist_ok=True)
    for name, place in found["console_scripts"].items():
        module, function = place.split(":"); path = f"/opt/site/bin/{name}"
        if not os.path.exists(path):
            open(path, "w").write(f"#!/usr/bin/env python3\nfrom {module} import {function}\n{function}()\n"); os.chmod(path, 0o755)
