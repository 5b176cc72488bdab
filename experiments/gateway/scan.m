% Takes a scan over HTTP in MATLAB, or in GNU Octave: octave --no-gui scan.m [ADDRESS NAME]
address = 'http://127.0.0.1:8090';
name = 'matlab';
in_octave = exist('OCTAVE_VERSION', 'builtin') > 0;
if in_octave && numel(argv()) >= 2
  arguments = argv();
  [address, name] = arguments{end-1:end};
end
addpath(fileparts(mfilename('fullpath')));  % afspm_ask.m

state = afspm_ask(address, name, 'get', '/state');
fprintf('%s, the microscope is %s\n', state.mode, state.microscope.state);
afspm_ask(address, name, 'post', '/control?wait_s=20');  % with the usual lease of 60 s
region = struct('center_m', [1e-6 0], 'size_m', [5e-7 5e-7]);
settings = containers.Map('tip-bias-voltage', '500 mV');  % no field of a struct has a hyphen in its name
key = [name '-1'];
afspm_ask(address, name, 'post', '/scans', ...
          struct('region', region, 'shape', [64 64], 'settings', settings, 'key', key));
measured.state = 'running';
while strcmp(measured.state, 'running')
  measured = afspm_ask(address, name, 'get', ['/measurements/' key '?wait_s=20']);
end
told = afspm_ask(address, name, 'get', ['/scans/' measured.result '/values?channel=Height&format=base64']);
if in_octave
  heights = base64_decode(told.base64);
else
  heights = typecast(matlab.net.base64decode(told.base64), 'double');
end
heights = reshape(heights, told.shape(2), told.shape(1))';  % they come row after row
fprintf('%d x %d pixels, the highest at %.1f nm\n', size(heights, 1), size(heights, 2), max(heights(:)) * 1e9);
afspm_ask(address, name, 'delete', '/control');
