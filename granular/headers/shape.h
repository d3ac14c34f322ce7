// A field of stresses: its layers, see `granular.yield_set`; the axes of each shear; elements from layer to layer and along each axis.
// Steps read 28 fields: the address of a row of each takes two registers, that of a field is an argument. So on CUDA they count cells from
// a field's first (FIELD and FIELDS name fields, ROW comes before the row's), of which a thread has one (END). What they read AGAIN, where
// KEEP is never negative, which the compiler cannot know, is read again: else 48 addresses are held while the cell yields.
#ifdef __CUDA_ARCH__
#define INLINE
#define UNROLL
#define FIELD(NAME) auto* NAME = given.NAME.data;
#define FIELDS(NAME) {given.NAME##_x.data, given.NAME##_y.data, given.NAME##_z.data}
#define ROW (int)(k*s1 + j*s2)
#define END (begin + 1)
#define AGAIN(KEEP, CELL) ((KEEP) < (T)0 ? (CELL) + 1 : (CELL))
#else
#define FIELD(NAME)
#define FIELDS(NAME) XYZ(NAME)
#define ROW 0
#define END end
#define AGAIN(KEEP, CELL) (CELL)
#define INLINE __attribute__((always_inline))  // vectorized loops may call nothing: small functions inside them must vanish
#define UNROLL PRAGMA(clang loop unroll(full))  // nor may they have other loops inside
#endif
#define XYZ(FIELD) {FIELD##_x, FIELD##_y, FIELD##_z}
enum { NORMALS = DIM == 3 ? 3 : 1, SHEARS = DIM == 3 ? 3 : 1, FIRST = 1 + NORMALS };
constexpr int ALPHA[3] = {0, 0, 1}, BETA[3] = {1, 2, 2};
const long long nx = given.share_x.shape[2], layer = nx*given.share_x.shape[1]*given.share_x.shape[0];
const long long s[3] = {1, nx, nx*given.share_x.shape[1]};
