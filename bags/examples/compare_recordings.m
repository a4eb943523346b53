function result = compare_recordings(simulation, machine, varargin)
% COMPARE_RECORDINGS  Compare a recording of a simulation with one of the machine.
%   R = COMPARE_RECORDINGS(SIMULATION, MACHINE, '--margin', 'delay=8ms', ...) runs `pendulum compare`, which has to be
%   on the system's path, and returns its result: R.verdict.outcome, R.verdict.sentence, R.metrics, ...
  errors = [tempname() '.txt'];
  words = sprintf(' "%s"', simulation, machine, varargin{:});
  [code, text] = system(['pendulum compare --json' words ' 2> "' errors '"']);
  reason = fileread(errors);
  delete(errors);
  assert(code == 0, 'compare_recordings:failed', '%s', reason);
  result = jsondecode(text);
end
