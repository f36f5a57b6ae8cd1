// A program as people write it with firmata-io: `node firmata_io.js PORT`. What it sees it tells in lines of JSON;
// it goes on until its input ends.
"use strict";

const { SerialPort } = require("serialport");
const Firmata = require("firmata-io").Firmata;

const port = new SerialPort({ path: process.argv[2], baudRate: 57600 });
const board = new Firmata(port);
const tell = (what) => console.log(JSON.stringify(what));

board.on("error", (error) => tell({ error: String(error) }));
board.on("close", () => tell({ closed: true }));
board.on("string", (text) => tell({ text }));
board.on("ready", () => {
  tell({
    ready: board.firmware.name,
    version: board.version,
    pins: Object.fromEntries(board.pins.map((pin, number) => [number, pin.supportedModes]).filter(([, modes]) => modes.length)),
    analog: board.analogPins,
  });

  board.pinMode(9, board.MODES.SERVO);
  board.servoWrite(9, 120);
  board.pinMode(13, board.MODES.OUTPUT);
  board.digitalWrite(13, board.HIGH);
  board.pinMode(3, board.MODES.PWM);
  board.analogWrite(3, 200);
  board.queryPinState(9, () => tell({ mode: board.pins[9].mode, state: board.pins[9].state }));

  board.pinMode(2, board.MODES.INPUT);
  board.digitalRead(2, (value) => tell({ touch: value }));
  board.analogRead(0, (value) => tell({ distance: value }));

  board.servoWrite(10, 90);
});

process.stdin.resume();
process.stdin.on("end", () => port.close(() => process.exit(0)));
