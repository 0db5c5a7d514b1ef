// Returns the sum of `count` over the lanes before this one (lower 16 bits) and over all lanes (upper 16 bits).
return (int)before((float)count) | (int)sum((float)count) << 16;
