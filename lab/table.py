"""python lab/table.py RESULTS.jsonl ...: last figures of each run, and their distance to the arm "REFERENCE" (-r NAME) of the capture."""
import json, sys
reference = sys.argv[sys.argv.index("-r") + 1] if "-r" in sys.argv else None
rows, average, seconds = {}, {}, {}
for path in (a for a in sys.argv[1:] if a.endswith(".jsonl")):
    for line in open(path):
        row = json.loads(line)
        key = row["capture"], row["name"]
        if "seconds" in row: seconds[key] = row["seconds"]
        elif "average" in row: average[key] = row
        elif "head" in row and row["step"] >= rows.get(key, row)["step"]: rows[key] = row
print(f"{'capture':12} {'arm':22} {'step':>6} {'n':>7}  PSNR    SSIM    off     SSIM    train  mean of weights  faint  s    recorded")
for (capture, name), row in sorted(rows.items()):
    a, r = average.get((capture, name)), rows.get((capture, reference))
    gain = "" if r is None else f"  {row['head'][0] - r['head'][0]:+.2f} {row['head'][1] - r['head'][1]:+.4f}"
    mean = "-              " if a is None else f"{a['head'][0]:.2f} {a['head'][1]:.4f}"
    print(f"{capture:12} {name:22} {row['step'] + 1:6} {row['n']:7}  {row['head'][0]:.2f}  {row['head'][1]:.4f}  {row['base'][0]:.2f}  {row['base'][1]:.4f}  "
          f"{row.get('train') or 0:.2f}  {mean}  {row.get('faint', 0):.3f}  {seconds.get((capture, name), 0):.0f}  {row.get('recorded')}{gain}")
