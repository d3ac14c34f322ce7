// A field of stresses: its layers, see `granular.yield_set`; the axes of each shear; elements from layer to layer and along each axis.
#ifdef __CUDA_ARCH__
#define INLINE
#define UNROLL
#else
#define INLINE __attribute__((always_inline))  // vectorized loops may call nothing: small functions inside them must vanish
#define UNROLL PRAGMA(clang loop unroll(full))  // nor may they have other loops inside
#endif
#define XYZ(FIELD) {FIELD##_x, FIELD##_y, FIELD##_z}
enum { NORMALS = DIM == 3 ? 3 : 1, SHEARS = DIM == 3 ? 3 : 1, FIRST = 1 + NORMALS };
constexpr int ALPHA[3] = {0, 0, 1}, BETA[3] = {1, 2, 2};
const long long nx = given.share_x.shape[2], layer = nx*given.share_x.shape[1]*given.share_x.shape[0];
const long long s[3] = {1, nx, nx*given.share_x.shape[1]};
