// The value between the nodes of a cell.
const T* p = g + (c*s1 + b*s2 + a); const T* q = p + up;
const T p0 = p[0] + fx*(p[1] - p[0]), p1 = p[s2] + fx*(p[s2 + 1] - p[s2]);
const T q0 = q[0] + fx*(q[1] - q[0]), q1 = q[s2] + fx*(q[s2 + 1] - q[s2]);
const T low = p0 + fy*(p1 - p0), high = q0 + fy*(q1 - q0);
out[list[m]] = low + fz*(high - low);
