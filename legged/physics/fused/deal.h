// How many places the lanes before this one ask for, where this one asks for `count`; and in the upper half what all ask for.
return (int)before((float)count) | (int)sum((float)count) << 16;
