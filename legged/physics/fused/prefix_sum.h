// Returns the exclusive prefix sum of `count` over the lanes, and in the upper half its total.
return (int)before((float)count) | (int)sum((float)count) << 16;
