// The span of a row: cells that hold sand and the cells beside them.
const int* span = spans + 2*(k*(long long)given.spans.shape[1] + j);
const int begin = first > span[0] ? first : span[0], end = last < span[1] ? last : span[1];
if (begin >= end) continue;
