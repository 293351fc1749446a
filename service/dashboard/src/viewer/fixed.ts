/** A number with so many decimals, and never "-0". */
export const fixed = (value: number, decimals: number) => (Number(value.toFixed(decimals)) || 0).toFixed(decimals);
