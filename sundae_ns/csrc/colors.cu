#define PLACE \
    const float* eye = center + (center_step ? 3LL * i : 0); \
    float x = means[3 * i] - eye[0], y = means[3 * i + 1] - eye[1], z = means[3 * i + 2] - eye[2]; \
    const bool at_eye = x == 0 && y == 0 && z == 0; \
    if (at_eye) z = 1; \
    const float scale = rsqrtf(x * x + y * y + z * z); \
    x *= scale; \
    y *= scale; \
    z *= scale; \
    const float xx = x * x, yy = y * y, zz = z * z;

// One thread computes one channel of one Gaussian. `rest` holds num_rest coefficients of three channels each.
extern "C" __global__ void harmonic_colors(int n, int degree, const float* __restrict__ means,
                                           const float* __restrict__ center, int center_step,
                                           const float* __restrict__ dc, const float* __restrict__ rest, int num_rest,
                                           float* __restrict__ out) {
    const long long thread = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (thread >= 3LL * n) return;
    const long long i = thread / 3;
    const float* c = rest + i * num_rest * 3 + thread % 3;
    PLACE
    float sum = 0.5f + 0.28209479177387814f * dc[thread];
    if (degree > 0) sum += 0.48860251190291992f * (z * c[3] - y * c[0] - x * c[6]);
    if (degree > 1)
        sum += 1.0925484305920792f * (x * y * c[9] - y * z * c[12] - x * z * c[18] + 0.5f * (xx - yy) * c[21]) +
               0.31539156525252005f * (3 * zz - 1) * c[15];
    if (degree > 2)
        sum += 0.59004358992664352f * (y * (yy - 3 * xx) * c[24] + x * (3 * yy - xx) * c[42]) +
               1.4453057213202769f * z * (2 * x * y * c[27] + (xx - yy) * c[39]) -
               0.45704579946446574f * (5 * zz - 1) * (y * c[30] + x * c[36]) +
               0.37317633259011546f * z * (5 * zz - 3) * c[33];
    if (degree > 3)
        sum += 0.62583573544917614f * (4 * x * y * (xx - yy) * c[45] + (xx * xx - 6 * xx * yy + yy * yy) * c[69]) -
               1.7701307697799304f * z * (y * (3 * xx - yy) * c[48] + x * (xx - 3 * yy) * c[66]) +
               0.94617469575756008f * (7 * zz - 1) * (x * y * c[51] + 0.5f * (xx - yy) * c[63]) -
               0.66904654355728921f * z * (7 * zz - 3) * (y * c[54] + x * c[60]) +
               0.10578554691520431f * (zz * (35 * zz - 30) + 3) * c[57];
    out[thread] = sum < 0 ? 0 : sum;  // NaN stays
}

// One coefficient of a Gaussian: its gradient takes its place, and its part of the gradient of the direction is added.
#define TERM(K, VALUE, DX, DY, DZ)                                                             \
    {                                                                                          \
        const float value = VALUE;                                                             \
        float* c = own + 3 * (K - 1);                                                          \
        const float weight = c[0] * red + c[1] * green + c[2] * blue;                          \
        c[0] = value * red;                                                                    \
        c[1] = value * green;                                                                  \
        c[2] = value * blue;                                                                   \
        dx += weight * (DX);                                                                   \
        dy += weight * (DY);                                                                   \
        dz += weight * (DZ);                                                                   \
    }

// A block computes PER_BLOCK Gaussians. It reads their coefficients and writes their gradients as one piece.
extern "C" __global__ void harmonic_colors_backward(
    int n, int degree, const float* __restrict__ means, const float* __restrict__ center, int center_step,
    const float* __restrict__ rest, int num_rest, const float* __restrict__ colors, const float* __restrict__ gradient,
    float* __restrict__ grad_means, float* __restrict__ grad_dc, float* __restrict__ grad_rest) {
    __shared__ float coefficients[PER_BLOCK * MOST_REST];
    const long long first = blockIdx.x * (long long)PER_BLOCK;
    if (first >= n) return;
    const int count = n - first < PER_BLOCK ? (int)(n - first) : PER_BLOCK, stride = 3 * num_rest;
    const float* from = rest + first * stride;
    for (int k = threadIdx.x; k < count * stride; k += blockDim.x) coefficients[k] = from[k];
    __syncthreads();
    for (int p = threadIdx.x; p < count; p += blockDim.x) {
        const long long i = first + p;
        float* own = coefficients + p * stride;
        // Colours that are clamped have no gradient.
        const float red = colors[3 * i] > 0 ? gradient[3 * i] : 0;
        const float green = colors[3 * i + 1] > 0 ? gradient[3 * i + 1] : 0;
        const float blue = colors[3 * i + 2] > 0 ? gradient[3 * i + 2] : 0;
        PLACE
        const float xy = x * y, cos2 = xx - yy, sin3 = y * (3 * xx - yy), cos3 = x * (xx - 3 * yy);
        float dx = 0, dy = 0, dz = 0;
        grad_dc[3 * i] = 0.28209479177387814f * red;
        grad_dc[3 * i + 1] = 0.28209479177387814f * green;
        grad_dc[3 * i + 2] = 0.28209479177387814f * blue;
        if (degree > 0) {
            const float c1 = 0.48860251190291992f;
            TERM(1, -c1 * y, 0, -c1, 0)
            TERM(2, c1 * z, 0, 0, c1)
            TERM(3, -c1 * x, -c1, 0, 0)
        }
        if (degree > 1) {
            const float c1 = 1.0925484305920792f, c0 = 0.31539156525252005f;
            TERM(4, c1 * xy, c1 * y, c1 * x, 0)
            TERM(5, -c1 * y * z, 0, -c1 * z, -c1 * y)
            TERM(6, c0 * (3 * zz - 1), 0, 0, 6 * c0 * z)
            TERM(7, -c1 * x * z, -c1 * z, 0, -c1 * x)
            TERM(8, 0.5f * c1 * cos2, c1 * x, -c1 * y, 0)
        }
        if (degree > 2) {
            const float c3 = 0.59004358992664352f, c2 = 1.4453057213202769f, c1 = 0.45704579946446574f;
            const float c0 = 0.37317633259011546f, inner = 5 * zz - 1;
            TERM(9, -c3 * sin3, -6 * c3 * xy, -3 * c3 * cos2, 0)
            TERM(10, 2 * c2 * xy * z, 2 * c2 * y * z, 2 * c2 * x * z, 2 * c2 * xy)
            TERM(11, -c1 * y * inner, 0, -c1 * inner, -10 * c1 * y * z)
            TERM(12, c0 * z * (5 * zz - 3), 0, 0, c0 * (15 * zz - 3))
            TERM(13, -c1 * x * inner, -c1 * inner, 0, -10 * c1 * x * z)
            TERM(14, c2 * z * cos2, 2 * c2 * x * z, -2 * c2 * y * z, c2 * cos2)
            TERM(15, -c3 * cos3, -3 * c3 * cos2, 6 * c3 * xy, 0)
        }
        if (degree > 3) {
            const float c4 = 0.62583573544917614f, c3 = 1.7701307697799304f, c2 = 0.47308734787878004f;
            const float c1 = 0.66904654355728921f, c0 = 0.10578554691520431f;
            const float inner1 = z * (7 * zz - 3), inner2 = 7 * zz - 1, slope1 = 21 * zz - 3;
            TERM(16, 4 * c4 * xy * cos2, 4 * c4 * sin3, 4 * c4 * cos3, 0)
            TERM(17, -c3 * z * sin3, -6 * c3 * xy * z, -3 * c3 * z * cos2, -c3 * sin3)
            TERM(18, 2 * c2 * xy * inner2, 2 * c2 * y * inner2, 2 * c2 * x * inner2, 28 * c2 * xy * z)
            TERM(19, -c1 * y * inner1, 0, -c1 * inner1, -c1 * y * slope1)
            TERM(20, c0 * (zz * (35 * zz - 30) + 3), 0, 0, c0 * z * (140 * zz - 60))
            TERM(21, -c1 * x * inner1, -c1 * inner1, 0, -c1 * x * slope1)
            TERM(22, c2 * cos2 * inner2, 2 * c2 * x * inner2, -2 * c2 * y * inner2, 14 * c2 * z * cos2)
            TERM(23, -c3 * z * cos3, -3 * c3 * z * cos2, 6 * c3 * xy * z, -c3 * cos3)
            TERM(24, c4 * (x * cos3 - y * sin3), 4 * c4 * cos3, -4 * c4 * sin3, 0)
        }
        for (int k = 3 * ((degree + 1) * (degree + 1) - 1); k < stride; ++k) own[k] = 0;
        const float along = dx * x + dy * y + dz * z, reach = at_eye ? 0 : scale;  // length has no effect
        grad_means[3 * i] = reach * (dx - along * x);
        grad_means[3 * i + 1] = reach * (dy - along * y);
        grad_means[3 * i + 2] = reach * (dz - along * z);
    }
    if (!grad_rest) return;  // the coefficients are not trained
    __syncthreads();
    float* to = grad_rest + first * stride;
    for (int k = threadIdx.x; k < count * stride; k += blockDim.x) to[k] = coefficients[k];
}
