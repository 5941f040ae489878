// Requests to the studio's server, with the token from the fragment of the page's address.

const fragment = new URLSearchParams(location.hash.slice(1));
const token = fragment.get("t") ?? "";

/** The file named in the address. */
export const askedFile = fragment.get("f") ?? "";

/** The address of the drawing in that of the page. */
export const askedAddress = fragment.has("drawing") ? `drawing=${fragment.get("drawing")}` : "";

/** A request that failed or was refused; `status` and `details` come from the answer. */
export class RequestError extends Error {
  constructor(status, details) {
    super(details.problem ?? `the server answered ${status}`);
    Object.assign(this, {status, details});
  }
}

/** Send a request to one of the routes list, open, share, save, compile, diagnose, design. */
export async function ask(route, request = {}, signal = undefined) {
  let answer;
  try {
    answer = await fetch(`api/${route}`, {
      method: "POST", headers: {"Content-Type": "application/json", "X-Studio-Token": token}, body: JSON.stringify(request), signal,
    });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new RequestError(0, {problem: "the studio's server does not answer: is `udkjax studio` still running?"});
  }
  const found = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new RequestError(answer.status, found);
  return found;
}
