import { useState } from "preact/hooks";
import { api, Problem } from "../api";
import { ProblemNote } from "../parts/problem";

export function SignInPage({ onDone, problem }: { onDone: () => void; problem: Problem | null }) {
  const [key, setKey] = useState("");
  const [refusal, setRefusal] = useState(problem);
  const submit = async (event: Event) => {
    event.preventDefault();
    try {
      await api.signIn(key.trim());
      onDone();
    } catch (error) {
      setRefusal(error as Problem);
    }
  };
  return (
    <main class="narrow">
      <h1>gonio</h1>
      <form onSubmit={submit}>
        <label>
          Your lab's key
          <input type="password" autocomplete="current-password" value={key} onInput={(e) => setKey(e.currentTarget.value)} required />
        </label>
        <button class="primary">Sign in</button>
        <ProblemNote problem={refusal} />
        <p class="quiet">
          Whoever runs the service makes keys with <code>gonio keys create LAB</code>.
        </p>
      </form>
    </main>
  );
}
