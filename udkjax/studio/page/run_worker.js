// The thread that computes runs, so that the page answers every gesture meanwhile. Messages to it: {engine, data} loads an engine;
// {request} asks for its run; "stop" ends the run in progress. Its answers are runs, in the order of the requests, or {problem}.

import {computeRun} from "./page_run.js";
import {loadEngine} from "./player/engine.js";

let engine = null, isStopped = false, work = Promise.resolve();
const channel = new MessageChannel();  // a turn of it lets messages in without the delay of a timer
const turn = () => new Promise(done => { channel.port1.onmessage = done; channel.port2.postMessage(null); });

addEventListener("message", ({data}) => {
  if (data === "stop") isStopped = true;
  else work = work.then(() => answer(data)).catch(error => postMessage({problem: error.message}));
});

async function answer({data, request}) {
  if (data) engine = loadEngine(data);
  else {
    isStopped = false;
    postMessage({found: await computeRun(await engine, request, async () => { await turn(); return !isStopped; })});
  }
}
