// Okabe and Ito: told apart by all common kinds of colour vision; the same as in the printed report.
export const RIGHT = "#D55E00";
export const LEFT = "#0072B2";
export const MIDDLE = "#6b7685";

export function colourOf(...names: string[]): string {
  if (names.every((name) => name.startsWith("right"))) return RIGHT;
  if (names.every((name) => name.startsWith("left"))) return LEFT;
  return MIDDLE;
}
