// A thread updates PER_THREAD numbers. `step` is the number of this update, from 1 on. Nothing changes where `skip`
// is not 0. All reads are sent before the first is used, so that they wait for the memory together.
extern "C" __global__ void adam(int n, float* __restrict__ value, const float* __restrict__ gradient,
                                float* __restrict__ mean, float* __restrict__ square, const float* __restrict__ step,
                                const float* __restrict__ rate, const float* __restrict__ skip, double beta1,
                                double beta2, double log_beta1, double log_beta2, double eps) {
    const long long first = blockIdx.x * (long long)blockDim.x * PER_THREAD + threadIdx.x;
    float v[PER_THREAD], g[PER_THREAD], m[PER_THREAD], s[PER_THREAD];
#pragma unroll
    for (int k = 0; k < PER_THREAD; ++k) {
        const long long i = first + k * (long long)blockDim.x;
        const bool inside = i < n;
        v[k] = inside ? value[i] : 0;
        g[k] = inside ? gradient[i] : 0;
        m[k] = inside ? mean[i] : 0;
        s[k] = inside ? square[i] : 0;
    }
    if (skip && skip[0] != 0) return;
    // 1 - beta^step, without the cancellation of a difference.
    const float size = rate[0] / -expm1f(step[0] * (float)log_beta1);
    const float root = sqrtf(-expm1f(step[0] * (float)log_beta2));
    const float keep1 = (float)beta1, keep2 = (float)beta2, add1 = (float)(1 - beta1), add2 = (float)(1 - beta2);
#pragma unroll
    for (int k = 0; k < PER_THREAD; ++k) {
        const long long i = first + k * (long long)blockDim.x;
        if (i >= n) return;
        m[k] = keep1 * m[k] + add1 * g[k];
        s[k] = keep2 * s[k] + add2 * g[k] * g[k];
        mean[i] = m[k];
        square[i] = s[k];
        value[i] = v[k] - size * m[k] / (sqrtf(s[k]) / root + (float)eps);
    }
}
