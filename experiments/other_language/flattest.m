% Takes an overview, finds its flattest place, and scans that: a component in MATLAB or Octave, with the client in clients/java.
here = fileparts(mfilename('fullpath'));
javaaddpath(fullfile(here, '..', '..', 'clients', 'java', 'target', 'afspm-client.jar'));
experiment = javaMethod('begin', 'afspm.client.Component');
size_m = experiment.launch().number('size_m');
tiles = experiment.launch().number('tiles');
pixels = experiment.launch().number('pixels');
% a key has a scan taken once: started again after a crash, this script gets the scan of its earlier life
overview = experiment.scan(javaObject('afspm.client.Region', 0, 0, size_m, size_m), pixels, pixels, 'overview');
height = overview.channel('Height');
z = reshape(double(height.toArray()), height.columns(), height.rows())';  % z(row, column)

edge = pixels / tiles;
[x, y] = meshgrid(1:edge);
plane = [ones(edge^2, 1), x(:), y(:)];
least_m = Inf;
for row = 0:tiles - 1
  for column = 0:tiles - 1
    tile = z(row * edge + (1:edge), column * edge + (1:edge));
    roughness_m = sqrt(mean((tile(:) - plane * (plane \ tile(:))).^2));
    if roughness_m < least_m
      least_m = roughness_m;
      center_m = double(height.placeM(row * edge + (edge - 1) / 2, column * edge + (edge - 1) / 2));
    end
  end
end

region = javaObject('afspm.client.Region', center_m(1), center_m(2), size_m / tiles, size_m / tiles);
detail = experiment.scan(region, pixels, pixels, 'flattest');
place = sprintf('(%.0f, %.0f) nm', center_m(1) * 1e9, center_m(2) * 1e9);
experiment.note(sprintf('the flattest place, %.3f nm rms, is at %s', least_m * 1e9, place), detail.get(0));
experiment.log(['scanned the flattest place at ' place]);
experiment.end();
experiment.untilEnd();
