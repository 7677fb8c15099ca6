// A thread moves the centre of one primitive by R S^2 R^T e, where e is its noise times its gate.
extern "C" __global__ void add_noise(int n, float* __restrict__ means, const float* __restrict__ scales,
                                     const float* __restrict__ quats, const float* __restrict__ opacities,
                                     const float* __restrict__ noise, double strength, double sharpness,
                                     double threshold) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    const float opacity = 1 / (1 + expf(-opacities[i]));
    const float factor = (float)strength / (1 + expf(-(float)sharpness * ((float)threshold - opacity)));
    const float* q = quats + 4 * (long long)i;
    const float length = fmaxf(sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), 1e-12f);
    const float w = q[0] / length, x = q[1] / length, y = q[2] / length, z = q[3] / length;
    const float rotation[3][3] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
        {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
        {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
    const float* e = noise + 3 * (long long)i;
    float moved[3] = {0, 0, 0};
    for (int axis = 0; axis < 3; ++axis) {
        const float width = expf(scales[3 * (long long)i + axis]);
        const float along = rotation[0][axis] * e[0] + rotation[1][axis] * e[1] + rotation[2][axis] * e[2];
        for (int row = 0; row < 3; ++row) moved[row] += rotation[row][axis] * width * width * along;
    }
    for (int row = 0; row < 3; ++row) means[3 * (long long)i + row] += factor * moved[row];
}
