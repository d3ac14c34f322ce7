// Coefficients of lower faces: fields or numbers.
const auto face_x = [&](long long k) -> T { if constexpr (FIELD_X) return fx[k]; else return nx; };
const auto face_y = [&](long long k) -> T { if constexpr (FIELD_Y) return fy[k]; else return ny; };
const auto face_z = [&](long long k) -> T { if constexpr (FIELD_Z) return fz[k]; else return nz; };
