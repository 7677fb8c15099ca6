# arms.sh CAPTURE: the arms of the experiment as calls of `arm`
echo "arm gains $1 ns-train \"WORDS='--pipeline.model.photo-gains True'\" 42 43 44"
