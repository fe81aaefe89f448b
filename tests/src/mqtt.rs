//! The bytes of MQTT 5 packets, for clients that do what well-behaved clients do not.

/// A session that outlives its connection by an hour: the property of CONNECT.
pub const AN_HOUR: [u8; 5] = [0x11, 0, 0, 0x0E, 0x10];

/// Options of CONNECT.
pub struct Hello<'a> {
    /// Client id.
    pub id: &'a str,
    /// Keep-alive, seconds; 0 for none.
    pub keep_alive_s: u16,
    /// Whether a session of the client ends, if there is one.
    pub clean: bool,
    /// Properties, for example [`AN_HOUR`].
    pub properties: &'a [u8],
    /// Properties, topic and payload of the last will.
    pub will: Option<(&'a [u8], &'a str, &'a [u8])>,
    /// User and password.
    pub login: Option<(&'a str, &'a str)>,
}

impl Default for Hello<'_> {
    fn default() -> Self {
        Self { id: "", keep_alive_s: 60, clean: true, properties: &[], will: None, login: None }
    }
}

/// The bytes of CONNECT.
pub fn connect(hello: &Hello) -> Vec<u8> {
    let mut flags = if hello.clean { 2 } else { 0 };
    let mut payload = text(hello.id);
    if let Some((properties, topic, message)) = hello.will {
        flags |= 4;
        payload.push(properties.len() as u8);
        payload.extend([properties, &text(topic), &(message.len() as u16).to_be_bytes(), message].concat());
    }
    if let Some((user, password)) = hello.login {
        flags |= 0xC0;
        payload.extend([text(user), text(password)].concat());
    }
    let [high, low] = hello.keep_alive_s.to_be_bytes();
    let head = [0, 4, b'M', b'Q', b'T', b'T', 5, flags, high, low, hello.properties.len() as u8];
    packet(0x10, &[&head, hello.properties, &payload])
}

/// The bytes of PUBLISH; with QoS 1 its packet id is 1.
pub fn publish(topic: &str, payload: &[u8], qos: u8, retain: bool, properties: &[u8]) -> Vec<u8> {
    let id: &[u8] = if qos == 0 { &[] } else { &[0, 1] };
    let first = 0x30 | qos << 1 | u8::from(retain);
    packet(first, &[&text(topic), id, &[properties.len() as u8], properties, payload])
}

/// The bytes of SUBSCRIBE with QoS 1.
pub fn subscribe(filter: &str) -> Vec<u8> {
    packet(0x82, &[&[0, 1, 0], &text(filter), &[1]])
}

fn text(text: &str) -> Vec<u8> {
    [&(text.len() as u16).to_be_bytes(), text.as_bytes()].concat()
}

fn packet(first: u8, parts: &[&[u8]]) -> Vec<u8> {
    let body = parts.concat();
    let mut length = body.len();
    let mut bytes = vec![first];
    loop {
        let byte = (length % 128) as u8;
        length /= 128;
        bytes.push(if length > 0 { byte | 0x80 } else { byte });
        if length == 0 {
            break;
        }
    }
    [bytes, body].concat()
}
