package afspm.client;

import static org.junit.jupiter.api.Assertions.assertEquals;
import static org.junit.jupiter.api.Assertions.assertNull;
import static org.junit.jupiter.api.Assertions.assertTrue;

import com.google.gson.Gson;
import com.google.gson.JsonObject;
import org.junit.jupiter.api.Test;
import org.zeromq.ZMQ;

class SocketsTest {
    private static final String ADDRESS = "tcp://127.0.0.1:19874";

    private final ZMQ.Curve.KeyPair publisher = ZMQ.Curve.generateKeyPair();
    private final ZMQ.Curve.KeyPair known = ZMQ.Curve.generateKeyPair();

    @Test
    void withKeysWhatIsPublishedReachesThoseWhoseKeyIsKnownAndNobodyElse() {
        try (Publisher published = new Publisher(ADDRESS, launch("publisher", publisher).keys);
                Experiment friend = new Experiment(launch("known", known), 30);
                Experiment stranger = new Experiment(launch("stranger", ZMQ.Curve.generateKeyPair()), 30)) {
            PacketQueue heard = friend.listen("Note");
            PacketQueue overheard = stranger.listen("Note");
            friend.start();
            stranger.start();
            long last = 0;
            int came = 0;
            for (int tries = 0; came < 3 && tries < 200; tries++) {
                published.publish("Note", new byte[0], 5);
                Packet packet = heard.poll(0.05);
                if (packet != null) {
                    came++;
                    assertTrue(packet.timeNs() > last, "times increase, though the clock stands still");
                    last = packet.timeNs();
                }
            }
            assertEquals(3, came);
            assertNull(overheard.poll(0.5));
        }
    }

    private Launch launch(String name, ZMQ.Curve.KeyPair pair) {
        JsonObject peers = new JsonObject();
        peers.addProperty(publisher.publicKey, "publisher");
        peers.addProperty(known.publicKey, "known");
        JsonObject servers = new JsonObject();
        servers.addProperty(ADDRESS, "publisher");
        JsonObject keys = new JsonObject();
        keys.addProperty("public", pair.publicKey);
        keys.addProperty("secret", pair.secretKey);
        keys.add("peers", peers);
        keys.add("servers", servers);
        keys.addProperty("everywhere", true);
        return Launch.parse("{\"name\": \"" + name + "\", \"keys\": " + new Gson().toJson(keys)
                + ", \"sockets\": {\"subscribe\": [\"" + ADDRESS + "\"]}, \"envelopes\": [\"Note\"]}");
    }
}
