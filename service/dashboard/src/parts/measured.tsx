// What the lab measured for a calibration: a length that checks the board's squares, and the frame in which the board is the floor.

export interface Measured {
  first: string;
  second: string;
  metres: string;
  frame: string;
  thickness: string;
}

export const NOTHING_MEASURED: Measured = { first: "", second: "", metres: "", frame: "", thickness: "" };

/** Ask for it; `cameras` are the names of those that filmed the sweep. */
export function MeasuredForm({ value, cameras, onChange }: { value: Measured; cameras: string[]; onChange: (value: Measured) => void }) {
  const change = (name: keyof Measured) => (event: Event) => onChange({ ...value, [name]: (event.currentTarget as HTMLInputElement).value });
  const number = (name: keyof Measured, words: string) => (
    <div class="question">
      <label for={name}>{words}</label>
      <input id={name} inputMode="decimal" value={value[name]} onInput={change(name)} />
    </div>
  );
  const camera = (name: keyof Measured, words: string) => (
    <div class="question">
      <label for={name}>{words}</label>
      <select id={name} value={value[name]} onChange={change(name)}>
        <option value="">none</option>
        {cameras.map((one) => (
          <option key={one} value={one}>
            {one}
          </option>
        ))}
      </select>
    </div>
  );
  return (
    <details class="options">
      <summary>Measured with a tape; the board on the floor</summary>
      <p class="quiet">The distance between two lenses is all that can tell a board whose squares are not as large as its card says.</p>
      <div class="questions">
        {camera("first", "From the lens of")}
        {camera("second", "to the lens of")}
        {number("metres", "Distance, m")}
        {number("frame", "Frame of the sweep in which the board lies on the floor")}
        {number("thickness", "Thickness of the board, mm")}
      </div>
    </details>
  );
}

/** The parameters of the calibration; what is half filled in is asked for as it is, so that the service says what is wrong. */
export function measuredParameters({ first, second, metres, frame, thickness }: Measured): Record<string, unknown> {
  const number = (text: string) => Number(text.trim().replace(",", "."));
  return {
    ...((first || second || metres) && { known_lengths: [{ first, second, metres: number(metres) }] }),
    ...(frame.trim() && { floor_frame: number(frame) }),
    ...(thickness.trim() && { board_thickness_mm: number(thickness) }),
  };
}
