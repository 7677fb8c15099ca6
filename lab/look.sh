# Figures and words of the finished runs of a lease
ls -tr /tmp/out/few/*/result.json | while read -r f; do python3 - "$f" <<'P'
import json,sys
r=json.load(open(sys.argv[1]));c=r["measured"]["configurations"][0];m=c.get("mean",c);print(r["set"],r["arm"],r["seed"],{k:(round(v,4) if isinstance(v,float) else v) for k,v in m.items() if k in ("psnr","ssim","psnr_fitted")}, r["measured"].get("primitives"))
P
done; grep -H "exposure: divides\|the head is\|Chosen:\|Going back\|keeping .* of" /tmp/logs/*.log | sed 's/.*logs.//' | cut -c1-230
grep -H "photos are" /tmp/logs/*.log | sed 's/.*logs.//' | cut -c1-200
